"""How many examples hypothesis draws where one costs milliseconds; `make fuzz` draws others."""

from hypothesis import settings

FEW = settings(max_examples=20)
