"""A data set or a model in the browser: turned, articulated and fused again.

`sources` finds what is to be shown, `shown` is one object of it at any joint state, `layers` makes
numbers of what can be seen of an instance, `stage` has viser draw them, `panel` is what one chooses
with, `serve` the server, `guard` refuses the pages of other sites.
"""
