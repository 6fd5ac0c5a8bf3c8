"""Drivers: raw bytes from each device become samples; nothing here knows what they are for."""
