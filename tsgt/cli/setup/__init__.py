"""The command group ``setup``."""
