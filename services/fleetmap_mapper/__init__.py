"""Turns a survey drive into a visual map anchored in UTM."""
