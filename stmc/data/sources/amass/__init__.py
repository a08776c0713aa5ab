"""AMASS: its recordings, and the annotations that name them."""
