"""Stick and slip under `SetValuedCoulomb`: slipping and rolling in turn."""
