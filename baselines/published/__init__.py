"""Published findings about latent actions, reproduced on a CPU: one paper a file, one command each."""
