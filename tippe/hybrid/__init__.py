"""Contact loss, flight, landing, the stem and leaning on it: scenes with `contact="hybrid"`."""
