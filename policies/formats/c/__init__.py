"""Our policies as C99: written, compiled, loaded and checked."""
