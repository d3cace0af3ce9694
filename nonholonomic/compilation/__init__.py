"""How programs are compiled, kept in memory, and kept on disk."""
