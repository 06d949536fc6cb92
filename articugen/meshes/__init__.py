"""Triangle meshes and point files: read distrustfully, written, extracted, asked."""
