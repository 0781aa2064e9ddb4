"""Jobs: simulate, sysid, gradcheck."""
