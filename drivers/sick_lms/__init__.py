"""SICK LMS2xx laser scanner."""
