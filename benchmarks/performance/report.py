def write(r, o): pass
