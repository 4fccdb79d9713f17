"""What may be set: the schema of every config, its checks, and the YAML files that hold overrides."""
