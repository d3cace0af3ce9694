"""Recordings of a stroller, and the parameters identified from them."""
