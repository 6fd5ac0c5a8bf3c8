"""Track encoders on CAN."""
