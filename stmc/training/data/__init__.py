"""Batches for training, drawn from prepared data."""
