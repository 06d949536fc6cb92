"""Pictures for people: points and meshes in light."""
