"""The desk: what is done with a recording afterwards."""
