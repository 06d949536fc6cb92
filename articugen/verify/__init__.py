"""Whether data are what they claim: in their bytes, their geometry, and made once more."""
