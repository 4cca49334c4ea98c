"""Published results on gradients through simulators, a file per claim or few alike."""
