"""From recordings to a dataset; :func:`tofcapture.dataset.sample.make_sample` is the main path."""
