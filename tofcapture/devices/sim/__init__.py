"""The simulated station: a robot arm, a ToF camera and a stereo camera in one seeded world. Shipped, first class."""
