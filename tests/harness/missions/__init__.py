"""Whole missions with daemons: short ones, planted defects, kills, and what readers got of them."""
