"""USD models with UsdPhysics joints, as ArtVIP's: read by OpenUSD in a process of its own."""
