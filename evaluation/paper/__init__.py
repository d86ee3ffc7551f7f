"""The tables and figures of the paper, on users' data and free mocap.

    python -m evaluation.paper --help

``datasets`` finds scenes, ``views`` is what their cameras see, ``exemplars`` makes libraries of
them, ``systems`` lifts, ``study`` measures, ``report``, ``chart`` and ``figures`` show, ``runs``
puts it together beside what is ``published``. ``mlp`` trains the network compared with.
"""
