"""BABEL, and the lists of compositions that papers evaluate on."""
