"""The analytic world: what there is in it, and rays that find out how it looks."""
