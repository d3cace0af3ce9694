"""Estimate parameters of a top from measurements: recordings, inversion times, fits and posteriors."""
