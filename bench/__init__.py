"""Measurements, proofs and the paper's experiments. Imports all others; only `terrabound reproduce` imports it."""
