"""What learners read: a split packed, batches drawn from it."""
