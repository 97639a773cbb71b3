"""Universal Robots arms, read over RTDE (the controller's Real-Time Data Exchange, port 30004)."""
