"""What is on the disk, and that it is whole: shards, manifests, journals, and reading them."""
