"""Our own registration: a stereo image answers by projection which surface a ToF ray meets; no search, no normals of clouds."""
