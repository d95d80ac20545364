r"""Speech of SVOX Pico's six women with its words, for ``facediff adapt --voices --transcribed``.

flite's voices, which the bundled model is trained with, are men's. SVOX Pico (Apache-2.0, ``pip install ttspico``) has
women's in six languages, made from recordings. They say random words, every third of which holds a p, b or m, at
various rates and pitches; what a recording says is in the .txt of its name.

    $ python tools/pico_voices.py women
    $ facediff adapt --checkpoint puppet.ckpt --voices --transcribed women -o voices.ckpt
"""

from __future__ import annotations

import argparse
import random
import sys
import wave
from collections.abc import Sequence
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.synthetic.sentences import WORDS
from facediff.utils.files import atomic_folder

RATE = 16_000
GERMAN = """
Abend Ameise Apfel Arm Bahn Baum Becher Berg Bett Biene Bild Blume Boden Bombe Boot Brief Brot Brücke Bruder Buch
Butter Dach Darm Decke Farbe Fenster Fisch Fluss Frau Gabel Gruppe Hafen Hammer Himmel Hund Insel Kaffee Kammer Katze
Keller Kind Kissen Klappe Kuppel Lampe Leben Liebe Lippe Löffel Mann Maus Meer Messer Milch Morgen Musik Mutter Name
Nebel Nummer Paket Papier Pappe Pfeffer Pferd Post Probe Problem Pumpe Puppe Rad Raum Reifen Rippe Salz Satz Schaum
Schiff Schwester Seite Sommer Spiegel Stempel Straße Stuhl Sturm Suppe Tal Tee Teller Tisch Traum Treppe Trommel Tür
Turm Uhr Vater Vogel Wagen Wand Wasser Wein Winter Wort Wurm Zimmer Zucker acht bald bauen bezahlen bitte blau braun
breit bringen bunt danke drei eins finden fünf geben gehen gelb gestern grün groß halb heute hinten holen hören immer
kalt kaufen klein kommen kurz lachen lang laufen lesen lieb malen manchmal nehmen neun niemals oben plötzlich putzen
rot schmal schreiben schwarz schwimmen sechs sehen sieben sprechen springen suchen über unten unter vielleicht vier
vorne warm weinen weiß zehn zwei zwischen
"""
FRENCH = """
abeille abricot ami apporter arbre banane bateau beaucoup bébé beurre biberon bien bientôt blanc bleu boire bombe
bonbon botte bouche bras brun cave chambre chanter chapeau chat chaud cheval chien cinq citron couleur courir court
crème danser décembre demain derrière dessous dessus deux devant dix dormir écouter écrire enfant entre fenêtre femme
fourmi froid fromage gâteau grand hier homme huit île jamais jambe jaune jupe lampe lèvre lettre lire lit livre loin
long lune main maintenant maison mal maman manger manteau matin melon membre mer mettre mieux montagne mot moutarde
mur musique nager neige neuf nez noir nom nombre novembre œil oiseau ombre oreille page pain papa papier paquet
parfois parler peindre petit peu phrase pied plage pleurer plomb pluie plume place poire poisson poivre pomme pompe
pont port porte porter poule poupée prendre près problème prune quatre regarder robe roue rouge rue sauter septembre
sept six soir soleil soupe souris sucre table tambour tête timbre toit toujours train trois trop un ventre vert ville
village voiture
"""
SPANISH = """
abajo abeja abrigo ahora amar amarillo ámbar amigo ancho árbol arriba ayer azúcar azul bailar bambú banana barco bebé
beber bien blanco boca bomba bota brazo caballo cabeza calle caliente cama campo cantar carta casa cerca ciruela
ciudad coche color comer comprar construir correr corto crema cuarto cuatro cumbre delante detrás diez dormir dos
empezar entre escribir escuchar espalda frase frío gato grande hablar hambre hombre hormiga isla labio lámpara largo
leer lejos libro limón limpio llevar llorar lluvia luna madre mal mañana mano mantequilla manzana mar mejor melón mesa
miembro mirar montaña mostaza mucho mujer muñeca música nadar nariz negro nieve niño noche nombre noviembre nueve
número nunca ocho ojo oreja padre página pájaro palabra pan papel paquete pared pequeño pera perro pez pie pierna
pimienta pintar plaza plomo pluma poco poner problema pronto pueblo puente puerta puerto queso ratón reír rojo romper
ropa rueda saltar seis sello septiembre siempre siete silla sol sombra sombrero sopa también tambor tarde techo tiempo
tomar traer tren tres uno ventana ventre verde
"""
ITALIAN = """
adesso albero amare amico ape ascoltare ballare bambino bambola banana barca bene bere bianco bimbo blu bocca bomba
braccio burro caldo camera campo cane cantare cappello cappotto carta casa cavallo cinque città colore comprare corto
costruire correre crema davanti dieci dietro dipingere domani donna dormire due finestra formaggio formica frase
freddo gamba gatto giallo gonna grande ieri impero isola labbro lampada largo leggere letto lettera libro limone
lontano lungo macchina mai male mamma mangiare mano mare mattina meglio mela melone membro mettere molto montagna muro
musica naso nero neve nome notte nove novembre numero nuotare occhio ombra orecchio otto pacco paese pagina pancia
pane papà parlare parola pepe pera pesce piangere piazza piccolo piede piombo pioggia piuma poco pompa ponte porta
portare porto posta prendere presto problema prugna quattro ridere rombo rompere rosso ruota saltare schiena scrivere
sedia sei sempre sera sette settembre simbolo sole sopra sotto strada tamburo tavolo tempo testa tetto topo tre treno
tra uccello uno uomo verde vicino zucchero zuppa
"""
LANGUAGES = {
    "en-US": ("", WORDS),
    "en-GB": ("", WORDS),
    "de-DE": (".de", tuple(GERMAN.split())),
    "fr-FR": (".fr", tuple(FRENCH.split())),
    "es-ES": (".es", tuple(SPANISH.split())),
    "it-IT": (".it", tuple(ITALIAN.split())),
}
"""Pico's voices: the ending of a transcript's name that says its language, and words."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("output", type=Path, help="folder to make")
    parser.add_argument("--each", type=int, default=200, help="recordings of each voice")
    given = parser.parse_args(arguments)
    try:
        import ttspico
    except ImportError:
        sys.exit("pico_voices: ttspico is not installed; pip install ttspico")
    try:
        with atomic_folder(given.output) as folder:
            for voice, (ending, words) in LANGUAGES.items():
                draw, engine = random.Random(voice), ttspico.TtsEngine(voice)  # noqa: S311 - no secret
                lips = [word for word in words if set(word.lower()) & set("pbm")]
                for number in range(given.each):
                    engine.rate, engine.pitch = draw.randint(85, 124), draw.randint(80, 124)
                    some = (draw.choice(lips if draw.random() < 0.35 else words) for _ in range(draw.randint(5, 8)))
                    text, name = " ".join(some), f"{voice}_{number:03d}"
                    (folder / f"{name}{ending}.txt").write_text(f"{text}\n", encoding="utf-8")
                    with wave.open(str(folder / f"{name}.wav"), "wb") as file:
                        file.setparams((1, 2, RATE, 0, "NONE", ""))
                        file.writeframes(bytes(engine.speak(text)))
    except FaceDiffError as error:
        sys.exit(f"pico_voices: {error}")
    print(f"wrote {given.output}: {len(LANGUAGES) * given.each} recordings")


if __name__ == "__main__":
    main()
