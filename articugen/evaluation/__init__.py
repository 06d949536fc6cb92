"""What a learner is worth: labels, shapes, motions, axes, tables and figures; numpy alone."""
