"""What is on the disk, and that it is whole: shards, manifests, and reading them."""
