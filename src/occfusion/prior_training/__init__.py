"""How the embedded priors are trained: what each learns from, and how it is measured (`stage=prior`)."""
