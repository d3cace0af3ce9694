"""The codes of how a run stands or has ended."""

#: Still under way; at the horizon; on its event; where the model ceases to hold; given up by step control; given up
#: because it changed its phase too often, or because the forces are not determined.
RUNNING, REACHED_END, CROSSED, LEFT_DOMAIN, FAILED, UNRESOLVED = range(6)
