"""PPD, unsupervised pose-aware part decomposition (Kawana, Mukuta, Harada 2021), fed by shards.

Numbers of equations are those of the paper; docs/ppd.md lists every choice the paper leaves open.
This package is the only user of torch.
"""
