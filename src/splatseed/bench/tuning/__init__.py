"""Tuning: which seeds and which strategy are best for one scene, by short runs on that scene."""
