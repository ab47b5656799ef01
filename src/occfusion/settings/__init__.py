"""Typed settings: the schema behind `conf/`, checked as a whole before any work starts."""
