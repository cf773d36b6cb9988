"""Butcher tableaus of explicit Runge-Kutta methods.

Stage i starts at y + h sum_j a_ij k_j and has the rates k_i; a step ends at y + h sum_i b_i k_i. The
equations of motion do not depend on time, so the abscissas c_i, the row sums, are not needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ButcherTableau:
    """Coefficients of an explicit method."""

    order: int
    stages: tuple[tuple[float, ...], ...]  # for stage i the a_ij of earlier stages; the first row is empty
    weights: tuple[float, ...]  # b_i
    # b_i less those of an embedded method of order 3 or more; one longer than `weights` where that takes the
    # rates at the end of the step too.
    error: tuple[float, ...] = ()

    @property
    def with_end(self) -> ButcherTableau:
        """The same method with the rates at its end as one more stage, if its error takes them."""
        if len(self.error) <= len(self.stages):
            return self
        return replace(self, stages=(*self.stages, self.weights), weights=(*self.weights, 0.0))

    @property
    def used(self) -> tuple[tuple[int, ...], ...]:
        """For each stage, the numbers (from 0) of the stages it starts from."""
        return tuple(tuple(j for j, weight in enumerate(row) if weight) for row in self.stages)


# The classical method (W. Kutta, 1901), whose stages each start from the one before: stage i starts at
# y + RK4_OFFSETS[i] h k_{i-1}, and the step is h sum_i RK4_WEIGHTS[i] k_i.
RK4_OFFSETS = (0.0, 0.5, 0.5, 1.0)
RK4_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)

# M. Calvo, J. I. Montijano & L. Randez, A new embedded pair of Runge-Kutta formulas of orders 5 and 6,
# Computers Math. Applic. 20 (1990): the formula of order 6. Of five tableaus of order 6 and 7 it gave the
# smallest errors for its time on an arm, and its weights are small: Verner's "efficient" ones of up to 200
# multiply the rounding errors of the rates. With the rates at its end, an error of order h^6 is unique but
# for a factor: its elementary weights have the norm 1e-3, as those of order h^5 of Dormand and Prince's pair.
CALVO_6 = ButcherTableau(
    order=6,
    stages=(
        (),
        (2 / 15,),
        (1 / 20, 3 / 20),
        (3 / 40, 0.0, 9 / 40),
        (86727015 / 196851553, -60129073 / 52624712, 957436434 / 1378352377, 83886832 / 147842441),
        (
            -86860849 / 45628967,
            111022885 / 25716487,
            108046682 / 101167669,
            -141756746 / 36005461,
            73139862 / 60170633,
        ),
        (
            77759591 / 16096467,
            -49252809 / 6452555,
            -381680111 / 51572984,
            879269579 / 66788831,
            -90453121 / 33722162,
            111179552 / 157155827,
        ),
        (
            237564263 / 39280295,
            -100523239 / 10677940,
            -265574846 / 27330247,
            317978411 / 18988713,
            -124494385 / 35453627,
            86822444 / 100138635,
            -12873523 / 724232625,
        ),
    ),
    weights=(
        17572349 / 289262523,
        0.0,
        57513011 / 201864250,
        15587306 / 354501571,
        71783021 / 234982865,
        29672000 / 180480167,
        65567621 / 127060952,
        -79074570 / 210557597,
    ),
    error=(
        -0.09115832107274877,
        0.0,
        0.6701562290306999,
        -0.8131460825909458,
        0.31877143010120307,
        -0.014807621247692575,
        -0.9639592592336372,
        0.7467876515948215,
        0.1473559734183,
    ),
)

# The solution of order 8 of DOP853, and its difference from the embedded one of order 5: Hairer, Norsett &
# Wanner, Solving Ordinary Differential Equations I, section II.5 (2nd ed., 1993), after Dormand and Prince.
DORMAND_PRINCE_8 = ButcherTableau(
    order=8,
    stages=(
        (),
        (0.0526001519587677318785587544488,),
        (0.0197250569845378994544595329183, 0.0591751709536136983633785987549),
        (0.0295875854768068491816892993775, 0.0, 0.0887627564304205475450678981324),
        (
            0.241365134159266685502369798665,
            0.0,
            -0.884549479328286085344864962717,
            0.924834003261792003115737966543,
        ),
        (
            0.037037037037037037037037037037,
            0.0,
            0.0,
            0.170828608729473871279604482173,
            0.125467687566822425016691814123,
        ),
        (
            0.037109375,
            0.0,
            0.0,
            0.170252211019544039314978060272,
            0.0602165389804559606850219397283,
            -0.017578125,
        ),
        (
            0.0370920001185047927108779319836,
            0.0,
            0.0,
            0.170383925712239993810214054705,
            0.107262030446373284651809199168,
            -0.0153194377486244017527936158236,
            0.00827378916381402288758473766002,
        ),
        (
            0.624110958716075717114429577812,
            0.0,
            0.0,
            -3.36089262944694129406857109825,
            -0.868219346841726006818189891453,
            27.5920996994467083049415600797,
            20.1540675504778934086186788979,
            -43.4898841810699588477366255144,
        ),
        (
            0.477662536438264365890433908527,
            0.0,
            0.0,
            -2.48811461997166764192642586468,
            -0.590290826836842996371446475743,
            21.2300514481811942347288949897,
            15.2792336328824235832596922938,
            -33.2882109689848629194453265587,
            -0.0203312017085086261358222928593,
        ),
        (
            -0.93714243008598732571704021658,
            0.0,
            0.0,
            5.18637242884406370830023853209,
            1.09143734899672957818500254654,
            -8.14978701074692612513997267357,
            -18.5200656599969598641566180701,
            22.7394870993505042818970056734,
            2.49360555267965238987089396762,
            -3.0467644718982195003823669022,
        ),
        (
            2.27331014751653820792359768449,
            0.0,
            0.0,
            -10.5344954667372501984066689879,
            -2.00087205822486249909675718444,
            -17.9589318631187989172765950534,
            27.9488845294199600508499808837,
            -2.85899827713502369474065508674,
            -8.87285693353062954433549289258,
            12.3605671757943030647266201528,
            0.643392746015763530355970484046,
        ),
    ),
    weights=(
        0.0542937341165687622380535766363,
        0.0,
        0.0,
        0.0,
        0.0,
        4.45031289275240888144113950566,
        1.89151789931450038304281599044,
        -5.8012039600105847814672114227,
        0.31116436695781989440891606237,
        -0.152160949662516078556178806805,
        0.201365400804030348374776537501,
        0.0447106157277725905176885569043,
    ),
    error=(
        0.01312004499419488073250102996,
        0.0,
        0.0,
        0.0,
        0.0,
        -1.225156446376204440720569753,
        -0.4957589496572501915214079952,
        1.664377182454986536961530415,
        -0.3503288487499736816886487290,
        0.3341791187130174790297318841,
        0.08192320648511571246570742613,
        -0.02235530786388629525884427845,
    ),
)

# Dormand & Prince, A family of embedded Runge-Kutta formulae, J. Comput. Appl. Math. 6 (1980): 5(4). The last
# stage starts where the step ends, so its rates are the first ones of the next step.
DORMAND_PRINCE_5 = ButcherTableau(
    order=5,
    stages=(
        (),
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ),
    weights=(35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84, 0.0),
    error=(71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40),
)

# At y + h sum_i k_i (theta b_i1 + theta^2 b_i2 + theta^3 b_i3 + theta^4 b_i4) the solution passes a share
# theta of the step, to order 4: Shampine, Some practical Runge-Kutta formulas, Math. Comp. 46 (1986). Row i
# has the coefficients of stage i.
DORMAND_PRINCE_DENSE = (
    (1.0, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432),
    (0.0, 0.0, 0.0, 0.0),
    (0.0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799),
    (0.0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072),
    (0.0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632),
    (0.0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844),
    (0.0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423),
)
