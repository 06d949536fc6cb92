"""Who makes the objects of a run: this machine, a Dask cluster, an array of SLURM."""
