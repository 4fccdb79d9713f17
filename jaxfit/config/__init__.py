"""Configs: keys, defaults, descriptions and checks of every config, and the YAML files that hold overrides."""
