"""Attacks: damaged files of every format that is read, kills at any moment, and what must come of them."""
