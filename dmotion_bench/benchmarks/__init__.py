"""Speeds on this machine beside what bounds them; ``dmbench bench`` shows them. No test asserts a time."""
