"""Files and lines of every kind, right and damaged, and commands that read them."""
