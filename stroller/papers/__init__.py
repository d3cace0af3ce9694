"""The printed equations of the paper on the stroller, each with the verdict of an audit."""
