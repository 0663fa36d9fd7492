"""Where OpenCV geometry lives: features, matching, absolute pose, place recognition."""
