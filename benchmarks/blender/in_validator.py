"""Judges a USD file by the rules of NVIDIA's asset validator. Needs omniverse-asset-validator.

    python in_validator.py FILE.usdc [RULE ...]

The rules named are left out. The last line of standard output is JSON: how many rules, and what they found.
"""

import json
import sys

from omni.asset_validator import CategoryRuleRegistry, ValidationEngine


def main() -> None:
    path, *ignored = sys.argv[1:]
    registry = CategoryRuleRegistry()
    rules = [rule for category in registry.categories for rule in registry.get_rules(category)]
    engine = ValidationEngine(init_rules=False)
    used = [rule for rule in rules if rule.__name__ not in ignored]
    for rule in used:
        engine.enable_rule(rule)
    found = [
        f"{issue.severity.name}: [{issue.rule.__name__}] {issue.message} {issue.at or ''}"
        for issue in engine.validate(path).issues()
    ]
    print(json.dumps({"problems": found, "summary": f"{len(used)} rules of the validator: {len(found)} issues"}))


main()
