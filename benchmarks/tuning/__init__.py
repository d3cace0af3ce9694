"""The parts of `tune_pair.py`: the order conditions, the family of pairs, and the motions for which the pair is
tuned."""
