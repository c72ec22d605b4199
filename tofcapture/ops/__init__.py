"""Pure stages on arrays: no clock, no files, no devices, no random state but a passed Generator.

The stages are independent of each other (import-linter holds it); ``dataset.sample.make_sample`` strings them together.
"""
