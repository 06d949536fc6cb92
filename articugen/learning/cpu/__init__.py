"""What a CPU does faster than torch asks it to, for whatever learner."""
