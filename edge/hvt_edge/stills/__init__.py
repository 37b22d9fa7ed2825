"""ROI stills: which candidate gets one, its crop, its coding, and its life until it is acknowledged."""
