"""Where objects come from: every source gives the same `ArticulatedObject`."""
