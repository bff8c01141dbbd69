"""The command line: thin commands over the packages below, and the only place that knows click."""
