"""`python -m jaxmb`, the same as `jaxmb`."""

from .cli import main

raise SystemExit(main())
