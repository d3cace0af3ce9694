"""The printed equations and tables of the papers on the tippe top, each with the verdict of an audit."""
