"""Who makes the objects of a run, beside this machine."""
