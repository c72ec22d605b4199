"""The only room with h5py: formats as data, and what reads, writes and checks them."""
