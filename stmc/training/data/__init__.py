"""Batches that training draws from prepared data."""
