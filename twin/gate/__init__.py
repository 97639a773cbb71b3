"""The verdict service: a plan comes in over the wire, I(tau) goes out, before the robot moves."""
