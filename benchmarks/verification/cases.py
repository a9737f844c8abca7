"""All cases, in the order of the page."""

from verification import cantilever, contact, cook, frequencies, homogeneous, manufactured, other_codes, spin

_MODULES = (manufactured, homogeneous, other_codes, cook, cantilever, frequencies, contact, spin)

CASES = {module.CASE.name: module.CASE for module in _MODULES}
