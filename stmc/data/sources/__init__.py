"""Data sets as they are published: each module knows one layout or file format, and none of the others."""
