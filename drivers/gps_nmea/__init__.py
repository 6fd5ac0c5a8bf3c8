"""GPS receiver (NMEA 0183)."""
