"""Stores, versions and lists maps; serves them over Zenoh and HTTP."""
