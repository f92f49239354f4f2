def run_crowd(*a): pass
