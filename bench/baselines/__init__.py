"""What others do with the same readings: filters and elevation maps to compare with."""
