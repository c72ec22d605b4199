"""Estimate 480x360 depth and normals jointly from ToF raw data. Importing this package does not import torch."""
