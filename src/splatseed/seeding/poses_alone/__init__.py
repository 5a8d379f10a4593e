"""Scenes that have poses and no points: are the poses sound, and where would trainers begin?"""
