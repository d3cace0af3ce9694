"""A user's functions of one run, mapped over lanes: traced once, and evaluated component by component."""
