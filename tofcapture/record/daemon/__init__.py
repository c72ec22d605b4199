"""The capture daemon: a durable queue of scenes, one recorder process at a time, a local API and a page.

The daemon itself touches no device and no view file. It starts ``worker`` as a child, which opens the station and runs
``record.recorder.record``; either may die at any moment without harm to the other's files.
"""
