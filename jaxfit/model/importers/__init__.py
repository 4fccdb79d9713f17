"""Importers of published bird models: they read the files that the authors released, without PyTorch."""
