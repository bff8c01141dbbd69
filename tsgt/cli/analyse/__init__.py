"""The group ``analyse``: studies of prism layouts, of noise, and of GNSS receivers against total stations."""
