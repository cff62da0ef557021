"""What the docs site is made of beside its pages: parts that follow the code."""
