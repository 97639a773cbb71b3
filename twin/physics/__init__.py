"""What moves when touched: rigid bodies and contact (PyBullet)."""
