"""Coefficients of Rosenbrock methods.

For y' = f(y) with Jacobian J at the start of a step h, the stages u_i solve

    (1 - gamma h J) u_i = gamma h f(y + sum a_ij u_j) + gamma sum c_ij u_j,   sums over j < i,

the form that needs no product with J (Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7).
All methods here are L-stable and stiffly accurate: the new y is where the last of s stages starts, plus u_s.
"""

from __future__ import annotations

from dataclasses import dataclass

Row = tuple[float, ...]


@dataclass(frozen=True)
class RosenbrockTableau:
    """Coefficients of a method with s stages."""

    order: int
    gamma: float  # shared by all stages
    starts: tuple[Row, ...]  # a_ij, s rows, row i of i numbers
    couplings: tuple[Row, ...]  # c_ij, s rows, row i of i numbers

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.starts)


# Hairer & Wanner, the code RODAS; 6 stages.
_RODAS4_LAST = (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895)
RODAS4 = RosenbrockTableau(
    order=4,
    gamma=0.25,
    starts=(
        (),
        (1.544,),
        (0.9466785280815826, 0.2557011698983284),
        (3.314825187068521, 2.896124015972201, 0.9986419139977817),
        _RODAS4_LAST,
        (*_RODAS4_LAST, 1.0),
    ),
    couplings=(
        (),
        (-5.6688,),
        (-2.430093356833875, -0.2063599157091915),
        (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
        (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616),
        (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
    ),
)

# Steinebach, Construction of Rosenbrock-Wanner method Rodas5P, BIT Numerical Mathematics 63, 2023; 8 stages.
_RODAS5P_LAST = (
    -7.502846399306121,
    2.561846144803919,
    -11.627539656261098,
    -0.18268767659942256,
    0.030198172008377946,
)
RODAS5P = RosenbrockTableau(
    order=5,
    gamma=0.21193756319429014,
    starts=(
        (),
        (3.0,),
        (2.849394379747939, 0.45842242204463923),
        (-6.954028509809101, 2.489845061869568, -10.358996098473584),
        (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
        _RODAS5P_LAST,
        (*_RODAS5P_LAST, 1.0),
        (*_RODAS5P_LAST, 1.0, 1.0),
    ),
    couplings=(
        (),
        (-14.155112264123755,),
        (-17.97296035885952, -2.859693295451294),
        (147.12150275711716, -1.41221402718213, 71.68940251302358),
        (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
        (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471),
        (
            30.91273214028599,
            -3.1208243349937974,
            77.79954646070892,
            34.28646028294783,
            -19.097331116725623,
            -28.087943162872662,
        ),
        (
            37.80277123390563,
            -3.2571969029072276,
            112.26918849496327,
            66.9347231244047,
            -40.06618937091002,
            -54.66780262877968,
            -9.48861652309627,
        ),
    ),
)
