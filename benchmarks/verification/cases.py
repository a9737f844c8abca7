"""All cases, in the order of the page."""

from verification import homogeneous, manufactured

CASES = {module.CASE.name: module.CASE for module in (homogeneous, manufactured)}
