"""Metrics and reports against ground truth."""
