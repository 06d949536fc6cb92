"""A data set on one page: a self-contained HTML file that opens anywhere, offline.

`facts` reads the shards once; `truth` and `turnable` look closer at what it found; `page` says all
of it in HTML, with what stands in `markup` and the two files beside it.
"""
