"""Text in pictures: one size of one typeface, in pixels, so that pictures need no library that draws."""

import base64
import functools
import zlib

import numpy as np
from numpy.typing import NDArray

HEIGHT, WIDTH = 13, 7
"""Of a character, pixels."""
_CHARACTERS = "".join(map(chr, range(32, 127))) + "µ²³·×"
# DejaVu Sans Mono Bold, 12 pixels, black and white, one bit a pixel; its licence is free for any use.
_BITS = (
    b"c-m!CL1@!p6#mneq=(R!O(m1j1@-9R-zsH?&{YICLD@}2J!D!kkl;E5Ex6UzKqoS&Q;?N{3cCnHP=fZLY>kyoq@j2a4FjzXcJi<}"
    b"lz|R>?@zi;{13^O$9v!V-uJ%{vinF>wG1Lk07b`a$LEIM?fLU82`D%@f9&gpp9>K}_>M!du1`aEst`_FdEsnDp8&|Sa&}}3KB$_k"
    b"=17FfK+Oj!kofj?_dia0Ih-$WBO)hvTJd7U1xn^$W%#@qh{*XsP=>N^C!LB`pJ_rggQ|Hk3s9Ibcxj{%MomAcy5#4l*O9cl-%K@X"
    b"JZ99TL`d9!1v4@=q3)O(HtI1#615Bw6|L#cv}Tu(TCvOVQLCWrh~Nwt`hkn8IfQ}hQ~qks)0ySAT;LP(wO4E`p_7-?Di%Q5+iUOV"
    b"j^F+zBiYF6n_^6ZXt-o*8|C;Il8oO+%Tj4<u0wZy1)B@sB|2dl0&3be`0y-MaR8wUCcmmJL!m#eJBylKMxU~6L;MJ&BcqVPmE(<Q"
    b"JZ0Y^D4oRzQ2yaBi&<!-0=8EwV=I-*b=1@WWbsrHIlzzwTnyB70wg(im7u5EjO#e$=Dtu^aJ?RoTynHs2Y2mq45iwo1B1mVyT;zt"
    b"k567g9I5*T3!;>{hvC<DX|?8VPuMDm)MD3|W<r4yFqM<ZT%Pmsglk2o(6Sel{CBu~ZujRn9d*nE+s*_I#=Iun(izul&fq6;u!k%;"
    b"9MiUqPG}gS7dKcV7Ea)GGz?6}*_qd(#5FyyVKo$Yc0%BB>Vcv=v!oRhLyV*6`K1r@rymi|R#U6H%g(6X=8Src;ol(1Oo*(|W5&Yz"
    b"`Kar))VtND?qXgySq5BO)Kk4&Jm-21VjEE@v&q6-xo@!O4K~pFWfW*3p{?sA5QLvH?}L}SLOirDx>kn#Eoae4{qs{`YaR_my`U0Q"
    b"4_4d8Q`G~$;YKt&M95!n;~9M"
)


def lettered(text: str, scale: int = 1) -> NDArray[np.bool_]:
    """Where the ink of a line of text is, as a picture (13 * scale, 7 * len(text) * scale); a character it lacks is "?"."""
    indices = [_CHARACTERS.find(character) for character in text]
    unknown = _CHARACTERS.index("?")
    glyphs = _glyphs()[[unknown if index < 0 else index for index in indices]]
    return np.kron(glyphs.swapaxes(0, 1).reshape(HEIGHT, -1), np.ones((scale, scale), bool))


@functools.cache
def _glyphs() -> NDArray[np.bool_]:
    """The characters (n, HEIGHT, WIDTH)."""
    bits = np.unpackbits(np.frombuffer(zlib.decompress(base64.b85decode(_BITS)), np.uint8))
    return bits[: len(_CHARACTERS) * HEIGHT * WIDTH].reshape(-1, HEIGHT, WIDTH).astype(bool)
