"""Models of others, checked before anything is made of them: meshes, URDF, USD.

`faces` counts what is amiss with a part's triangles; `model` asks what is solid, how joints stand
and what they drive into; `door` does so to whole folders; `page` says it in HTML.
"""
