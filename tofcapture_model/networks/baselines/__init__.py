"""Methods that the model is compared with; one file each, all with the same two answers: depth and normals at 2x."""
