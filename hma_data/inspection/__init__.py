"""Look at recordings before and after conversion: `hma inspect`, `hma doctor`, `hma registry infer`.

In comes a recording or a shard set, out go facts, findings by severity, or the YAML of a new robot.
Next: `hma_data.conversion`.
"""
