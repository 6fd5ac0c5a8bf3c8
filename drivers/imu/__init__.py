"""Inertial packets (MAVLink)."""
