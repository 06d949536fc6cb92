"""Models of others, brought here: downloaded or unpacked, checked, with their terms beside them.

`partnet_mobility` and `local` are the doors; see docs/sources.md.
"""
