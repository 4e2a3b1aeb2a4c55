"""Where a motion brings the arm too close to itself or to what stands around it."""
