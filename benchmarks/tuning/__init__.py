"""What `tune_pair.py` puts together: the conditions of order, the family of pairs, and the motions it is tuned to."""
