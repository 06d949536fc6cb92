"""PPD, unsupervised pose-aware part decomposition (Kawana, Mukuta, Harada 2021), fed by shards.

Numbers of equations are those of the paper; docs/ppd.md lists every choice the paper leaves open.
`method.py` is its door: what `learning.method` asks for.
"""
