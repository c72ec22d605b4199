"""Simulated datasets by recipe: which scenes, from where, and the loop that makes shards of them."""
