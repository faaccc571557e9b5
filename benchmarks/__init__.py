"""What is measured: the paper's twelve panels, NSGA-II's reference fronts on them, and the benchmark."""
