"""Studies that simulate a system many times: `identify`, `optimise` and `robust`, `plan`, `sweep` and `batch`; for
small motions `linearise`, `root_locus`, `steady_motion` and `floquet`, and `lqr` for feedback; for a single motion
`required_forces` and `loads`. All are names of `jaxmb` itself.

```python
about_rest = jaxmb.linearise(system, jaxmb.equilibrium(system))
about_rest.eigenvalues
```
"""
