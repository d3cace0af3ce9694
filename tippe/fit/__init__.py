"""Measurements of a top, and the parameters identified from them: recordings, inversion times, fits and posteriors."""
