"""Contact loss, flight, landing and the stem: scenes with `contact="hybrid"`."""
