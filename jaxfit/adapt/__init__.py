"""Adaptation of a bird model to a species: from scans and from photographs; comparison and rigging of models"""
