"""Motions that no open recording shows, made by editing recordings: one recipe per action."""
