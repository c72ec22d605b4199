"""Recording: plan the views of a scene, take them, never twice, never half."""
