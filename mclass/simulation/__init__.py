"""Simulated drives past labelled objects: scenarios, the world they describe, logs of it."""
