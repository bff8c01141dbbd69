"""Radios and stations without chips: what the other side of a protocol sends, frame by frame, and an attacker."""
