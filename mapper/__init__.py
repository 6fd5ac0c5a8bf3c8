"""Mapper: scans and pose sets become a map of elevation intervals."""
