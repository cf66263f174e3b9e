"""Studies that simulate a system many times: `identify`, `optimise` and `robust`, `sweep` and `batch`; those of small
motions, `linearise`, `root_locus`, `steady_motion` and `floquet`; and those of one motion, `required_forces` and
`loads`. All of them are names of `jaxmb` itself.

```python
about_rest = jaxmb.linearise(system, jaxmb.equilibrium(system))
about_rest.eigenvalues
```
"""
