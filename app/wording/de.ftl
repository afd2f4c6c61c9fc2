# Alles, was Teilnehmende lesen, auf Deutsch. Jede Nachricht gibt es in jeder Sprache, mit denselben Variablen.

## Jede Seite

page-title = { $title } · PbARL Studio
page-language = Sprache
foot-withdraw = Teilnahme widerrufen
foot-code = Sie sind { $code }
back = Zurück
go-on = Weiter
page-incomplete = Diese Seite wurde nicht vollständig geladen.
page-load-again = Neu laden
saved = Gespeichert

## Begrüßung und Einwilligung

consent-title = Teilnahme
consent-welcome = Herzlich willkommen und vielen Dank für Ihr Interesse.
consent-body =
    Sie sehen Paare kurzer Videos, in denen ein Roboter einem Menschen hilft, und sagen jeweils, welcher Roboter Ihnen lieber ist. Aus Ihren Antworten lernt ein Roboter, die Aufgabe so auszuführen, wie Sie es mögen.

    - Sie vergleichen { $count } Paare. Machen Sie so viele Pausen, wie Sie möchten, auch tagelange: Ihr Link bringt Sie dorthin zurück, wo Sie waren.
    - Gespeichert werden Ihre Antworten, wann Sie sie gegeben haben und wie lange Sie dafür gebraucht haben, unter dem Kürzel { $code }. Wir fragen nicht nach Ihrem Namen und benutzen weder Kamera noch Mikrofon. Wenn Sie über ein Teilnahmeportal kommen, speichern wir auch die Kennung, unter der Sie dort geführt werden.
    - Die Teilnahme ist freiwillig. Sie können jederzeit ohne Angabe von Gründen aufhören: Schließen Sie einfach die Seite. Wenn Sie unten auf einer Seite „Teilnahme widerrufen“ wählen, wird alles über Sie gelöscht.
consent-visit = Sie haben schon einmal teilgenommen. Was Sie damals geantwortet haben, zählt weiter: Ihr Roboter lernt von dort aus weiter. Wenn Sie Ihre Teilnahme widerrufen, werden die Antworten aller Termine gelöscht.
consent-setting = Nach dem Vergleichen stellen Sie selbst einen Roboter mit Reglern ein. Wir speichern, was Sie einstellen, und daraus entsteht dieser Roboter.
consent-others = Zum Schluss bewerten Sie mehrere Roboter. Darunter können Roboter sein, die von anderen Menschen gelernt haben, und der Roboter, der von Ihnen gelernt hat, kann anderen gezeigt werden. Von wem ein Roboter gelernt hat, erfährt niemand, der ihn bewertet. Wenn Sie Ihre Teilnahme widerrufen, bekommt niemand Ihren Roboter neu zu sehen; wer schon angefangen hat, ihn zu bewerten, sieht ihn weiterhin. Auf Sie zurückführen lässt er sich dann nicht mehr.
consent-duration = Dauer: { $duration }
consent-payment = Vergütung: { $payment }
consent-ethics = Ethikvotum: { $ethics }
consent-contact = Fragen? Wenden Sie sich bitte an { $contact }
consent-contact-unknown = Fragen? Wenden Sie sich bitte an die Personen, die Sie zu dieser Studie eingeladen haben.
consent-version = Informationen für Teilnehmende, Version { $version }
consent-agree = Ich willige ein und nehme teil
consent-changed = Dieser Text hat sich geändert, seit Sie ihn zuletzt gesehen haben. Bitte lesen Sie ihn noch einmal.
consent-copy-link = Kopie speichern oder drucken
consent-copy-title = Worin Sie eingewilligt haben
consent-copy-before = Der Text, in den Sie einwilligen sollen
consent-copy-agreed = In diesen Text haben Sie am { $date } eingewilligt.
consent-copy-print = Drucken
consent-copy-save = Als Datei speichern
consent-copy-file = einwilligung

## Fragebögen: zur Person und zur Studie

demographics-title = Zu Ihrer Person
demographics-lead = Einige Fragen zu Ihnen, damit wir beschreiben können, wer teilgenommen hat. Sie können jede Frage auslassen.
scale-left-out =
    { $count ->
        [one] Eine Antwort fehlt.
       *[other] { $count } Antworten fehlen.
    } Sie können sie jetzt ergänzen oder ohne sie weitermachen.
scale-page = Seite { $place } von { $places }
scale-robot-title = Über Roboter { $letter }
questionnaire-title = Wie war es?
questionnaire-lead = Sie haben es fast geschafft. Zum Schluss noch einige Fragen; Sie können jede auslassen.
form-save = Speichern und weiter
form-no-answer = Keine Angabe
form-number-problem = Bitte geben Sie eine Zahl ein, oder lassen Sie das Feld leer.
form-long-problem = Bitte kürzen Sie diesen Text auf höchstens { $count } Zeichen.
form-choice-problem = Bitte wählen Sie eine der Antworten.
form-problems =
    { $count ->
        [one] Bitte sehen Sie sich eine Antwort noch einmal an. Es ist nichts verloren.
       *[other] Bitte sehen Sie sich { $count } Antworten noch einmal an. Es ist nichts verloren.
    }
form-likert-low = überhaupt nicht
form-likert-high = sehr
scale-end = { $point }: { $meaning }
form-age = Wie alt sind Sie?
form-gender = Welches Geschlecht haben Sie?
form-robot_experience = Wie viel Erfahrung haben Sie mit Robotern?
form-robot_experience-low = keine
form-robot_experience-high = sehr viel
form-felt_understood = Der Roboter hat verstanden, was ich möchte.
form-felt_understood-low = überhaupt nicht
form-felt_understood-high = vollkommen
form-felt_safe = Mit diesem Roboter würde ich mich sicher fühlen.
form-felt_safe-low = überhaupt nicht
form-felt_safe-high = vollkommen
form-would_use = Ich würde einen solchen Roboter benutzen.
form-would_use-low = auf keinen Fall
form-would_use-high = auf jeden Fall
form-made_for_you = Einer der Roboter, die Sie gerade bewertet haben, wurde für Sie gemacht: Er hat aus Ihren Antworten gelernt. Welcher war es? Wenn Sie es nicht wissen, wählen Sie den, der es Ihrer Meinung nach war.
form-comments = Möchten Sie uns sonst noch etwas mitteilen?

## Anleitung

instructions-title = So funktioniert es
task-other = Ein Roboterarm hilft einer sitzenden Person. Jedes Paar zeigt dieselbe Situation in zwei Ausführungen. Stellen Sie sich vor, dass Ihnen selbst geholfen wird.
task-lab = Ein Roboter bei seiner Aufgabe. Jedes Paar zeigt dieselbe Situation in zwei Ausführungen. Stellen Sie sich vor, dass Sie daneben stehen.
instructions-keys = Antworten und ihre Tasten
instructions-key = Taste
instructions-answer = Antwort
instructions-left = Links ist besser
instructions-top = Oben: Der obere ist besser
instructions-right = Rechts ist besser
instructions-bottom = Unten: Der untere ist besser
instructions-equal = Gleich gut: Ich finde beide gleich gut
instructions-skip = Weiß nicht: Ich konnte dieses Paar nicht beurteilen; es zählt nicht
instructions-replay = Von vorn abspielen
instructions-undo = Letzte Antwort zurücknehmen
instructions-space = Leertaste
instructions-player = Anhalten oder abspielen; mit den Schaltflächen unter den Videos gehen Sie Bild für Bild und ändern das Tempo
instructions-taste = Es gibt kein Richtig oder Falsch; nur Ihr eigener Geschmack zählt. Ein Tastendruck oder Tippen genügt, und das nächste Paar erscheint.
instructions-buttons = Die Schaltflächen bewirken dasselbe wie die Tasten.
instructions-start = Mit dem Vergleichen beginnen
instructions-practice = Mit der Übung beginnen

## Zum Schluss: der eigene Roboter

debrief-title = Das ist Ihr Roboter
debrief-title-making = Ihr Roboter
debrief-lead = „Vorher“ ist der Roboter, mit dem alle anfangen; „Ihr Roboter“ ist das, was Ihre Antworten aus ihm gemacht haben. Beide lösen dieselbe Aufgabe in derselben Situation, die für beide neu war.
debrief-before = Vorher
debrief-before-alt = Der Roboter, bevor er von Ihnen gelernt hat
debrief-after = Ihr Roboter
debrief-after-alt = Der Roboter, nachdem er von Ihnen gelernt hat
debrief-making = Ihr Roboter entsteht gerade
debrief-making-text = Er lernt aus Ihren Antworten und wird dann gefilmt. Das kann eine Weile dauern. Sie brauchen nicht zu warten: Gehen Sie weiter, und öffnen Sie Ihren Link später noch einmal, um ihn zu sehen.
debrief-films-making = Die Videos entstehen gerade
debrief-films-making-text = Ihr Roboter hat gelernt; nun wird er gefilmt. Sie brauchen nicht zu warten: Gehen Sie weiter, und öffnen Sie Ihren Link später noch einmal, um ihn zu sehen.
debrief-learned = Was er von Ihnen gelernt hat
debrief-learned-how = Verglichen mit dem Roboter vorher, in { $count } Situationen, die neu für ihn waren:
debrief-learned-reference = Wir haben in { $count } Situationen, die für den Roboter neu waren, ausprobiert, was Ihre Antworten nahelegten. Nichts davon war für Sie eindeutig besser, ohne auch einen Nachteil zu haben. Ihr Roboter ist deshalb der, mit dem alle anfangen: Beide Videos zeigen denselben Roboter.
debrief-learned-nothing = In { $count } Situationen, die neu für ihn waren, bewegt er sich ganz ähnlich wie der Roboter vorher. Entweder gefiel Ihnen der schon, oder Ihre Antworten wiesen in verschiedene Richtungen; beides ist in Ordnung.
debrief-pace-quicker = Er bewegt sich schneller (um { $percent } %) und ist früher bei Ihnen.
debrief-pace-calmer = Er bewegt sich langsamer (um { $percent } %) und lässt sich auf dem Weg zu Ihnen mehr Zeit.
debrief-pace-less-motion = Er bewegt sich weniger (um { $percent } %) und ist trotzdem früher bei Ihnen.
debrief-pace-more-motion = Er bewegt sich mehr (um { $percent } %) und braucht doch länger bis zu Ihnen.
debrief-C_d-less = Er ist früher bei Ihnen.
debrief-C_d-more = Er lässt sich auf dem Weg zu Ihnen mehr Zeit.
debrief-C_d-much = Er lässt sich auf dem Weg zu Ihnen viel mehr Zeit.
debrief-C_v-less = Er bewegt sich langsamer (um { $percent } %).
debrief-C_v-more = Er bewegt sich schneller (um { $percent } %).
debrief-C_v-much = Er bewegt sich viel schneller.
debrief-C_f-less = Er berührt Sie weniger, wo er es nicht soll (um { $percent } %).
debrief-C_f-more = Er berührt Sie mehr, wo er es nicht soll (um { $percent } %).
debrief-C_f-little = Er berührt Sie etwas mehr, wo er es nicht soll; vorher kam das kaum vor.
debrief-C_f-much = Er berührt Sie viel mehr, wo er es nicht soll.
debrief-C_hf-less = Wo er Sie berühren soll, drückt er weniger stark (um { $percent } %).
debrief-C_hf-more = Wo er Sie berühren soll, drückt er stärker (um { $percent } %).
debrief-C_hf-little = Wo er Sie berühren soll, drückt er manchmal etwas stärker.
debrief-C_hf-much = Wo er Sie berühren soll, drückt er viel stärker.
debrief-C_fd-less = Er verschüttet weniger auf Sie (um { $percent } %).
debrief-C_fd-more = Er verschüttet mehr auf Sie (um { $percent } %).
debrief-C_fd-little = Er verschüttet etwas mehr auf Sie; vorher war es so gut wie nichts.
debrief-C_fd-much = Er verschüttet viel mehr auf Sie.
debrief-C_fdv-less = Was er Ihnen reicht, gelangt langsamer in Ihren Mund (um { $percent } %).
debrief-C_fdv-more = Was er Ihnen reicht, gelangt schneller in Ihren Mund (um { $percent } %).
debrief-C_fdv-much = Was er Ihnen reicht, gelangt viel schneller in Ihren Mund.
debrief-done = Abschließen

## Das Ende

finished-title = Vielen Dank!
finished-lead = Sie haben die Studie abgeschlossen, und alle Ihre Antworten sind sicher gespeichert.
finished-lead-pairs = Alle { $count } Antworten sind sicher gespeichert. Sie können diese Seite schließen.
finished-code = Ihr Abschlusscode
finished-copy = Kopieren
finished-copied = Kopiert.
finished-return = Jetzt zurückkehren
finished-return-lead = Ein letzter Schritt: Kehren Sie zu der Seite zurück, von der Sie gekommen sind, damit man dort weiß, dass Sie fertig sind.
finished-return-soon = In wenigen Sekunden werden Sie dorthin weitergeleitet.
finished-stay = Hierbleiben
finished-sending = Einen Moment: Ihre letzte Antwort ist noch unterwegs.
finished-debrief = Ihren Roboter ansehen
finished-robot-ready = Ihr Roboter ist fertig
finished-robot-ready-text = Er hat aus Ihren Antworten gelernt. Die Person, von der Sie den Link haben, kann ihn Ihnen jetzt zeigen.
finished-robot-making = Ihr Roboter wird vorbereitet
finished-robot-making-text = Er lernt aus Ihren Antworten. Sie brauchen nicht darauf zu warten.
finished-robot-progress = Wie weit Ihr Roboter ist
finished-visit-title = Ihr nächster Termin
finished-visit-open = Sobald Sie möchten, kann es weitergehen. Ihr Roboter lernt von dort aus weiter, wo er jetzt steht.
finished-visit-begin = Nächsten Termin beginnen
finished-visit-later = Ab { $date } können Sie wiederkommen. Bitte bewahren Sie Ihren Link auf: Er führt Sie dann dorthin.
finished-undo = Meine letzte Antwort zurücknehmen
ended-title = Vielen Dank für Ihr Interesse
ended-screened-out = Diese Studie richtet sich im Moment an andere Personen und endet deshalb hier für Sie. Sie haben nichts falsch gemacht.
ended-full = Es nehmen bereits so viele Personen teil, wie gebraucht werden; deshalb endet die Studie hier für Sie. Sie haben nichts falsch gemacht.
ended-inattentive = Mehrere Ihrer Antworten passten nicht zu dem, was auf den Videos zu sehen war; deshalb endet die Studie hier für Sie.
ended-kept = Ihre Antworten bleiben gespeichert. Wenn sie gelöscht werden sollen, wählen Sie unten „Teilnahme widerrufen“.

## Widerruf

withdraw-title = Teilnahme widerrufen
withdraw-lead = Sie können Ihre Teilnahme jederzeit widerrufen und brauchen keinen Grund zu nennen. Wenn Sie das tun, geschieht Folgendes:
withdraw-body =
    - Alles, was Sie uns mitgeteilt haben, wird gelöscht: Ihre Antworten, Ihre Fragebögen, der Text Ihrer Einwilligung, Ihre Bewertungen.
    - Alles, was daraus entstanden ist, wird gelöscht: der Roboter, der von Ihnen gelernt hat, seine Videos und Dateien.
    - Es bleibt nur der Vermerk, dass { $code } teilgenommen und widerrufen hat und wann das war. Daraus geht weder hervor, wer Sie sind, noch, was Sie uns mitgeteilt haben.
    - Ergebnisse, die schon veröffentlicht sind, lassen sich nicht zurückholen.
withdraw-average = Die Roboter von Menschen, die nach Ihnen kamen, sind möglicherweise von einem Durchschnitt ausgegangen, zu dem Ihrer beigetragen hat. Auf Sie zurückführen lässt er sich nicht.
withdraw-others = Vielleicht haben andere schon angefangen, den Roboter zu bewerten, der von Ihnen gelernt hat. Sie sehen ihn weiterhin, aber nichts weist mehr darauf hin, dass es Ihrer war. Wer noch nicht angefangen hat, bekommt ihn nicht mehr zu sehen.
withdraw-final = Das lässt sich nicht rückgängig machen, auch nicht von uns.
withdraw-confirm = Alles über mich löschen
withdraw-keep = Nein, alles behalten
withdrawn-title = Ihre Daten sind gelöscht
withdrawn-lead = Sie haben Ihre Teilnahme widerrufen, und alles über Sie wurde gelöscht. Vielen Dank für Ihre Zeit.
withdrawn-text = Die letzten Spuren auf unseren Rechnern verschwinden innerhalb weniger Minuten. Sie können diese Seite schließen; Ihr Link führt von jetzt an hierher.

## Teilnahme über ein Teilnahmeportal oder eine offene Adresse

join-title = Herzlich willkommen
join-start-lead = Sie sind eingeladen, an einer Studie teilzunehmen.
join-start-text = Über die Schaltfläche gelangen Sie zur Studie. Dort lesen Sie zuerst, was die Teilnahme bedeutet, und entscheiden dann. Bis Sie darauf drücken, wird nichts gespeichert.
join-start = Zur Studie
join-missing-title = In dieser Adresse fehlt etwas
join-missing = Wir können nicht erkennen, wer Sie sind: Die Adresse sollte { $parameter } enthalten. Bitte öffnen Sie die Studie noch einmal über die Seite, auf der sie Ihnen angeboten wurde. Wenn das nicht hilft, wenden Sie sich an deren Betreiber.
join-link-lead = Dies ist Ihr persönlicher Link. Bewahren Sie ihn auf, falls Sie später oder auf einem anderen Gerät weitermachen möchten, und geben Sie ihn nicht weiter.
join-link-label = Ihr persönlicher Link
join-link-copy = Kopieren

## Was schiefgehen kann

error-title-401 = Bitte öffnen Sie Ihren Link noch einmal
error-title-403 = Das ist nicht erlaubt
error-title-404 = Seite nicht gefunden
error-title-409 = Das geht nicht mehr
error-title-410 = Diese Studie ist geschlossen
error-title-link-revoked = Dieser Link wurde abgeschaltet
error-title-500 = Bei uns ist etwas schiefgegangen
error-title-503 = Einen Moment, bitte
error-title-other = Das hat nicht geklappt
error-number = Fehler { $status }
error-onward = Dorthin zurück, wo ich war
error-link-needed = Wir können nicht erkennen, wer Sie sind. Bitte öffnen Sie Ihren persönlichen Link noch einmal: Sie machen genau dort weiter, wo Sie waren.
error-link-not-valid = Dieser Link ist nicht gültig. Vielleicht wurde er durch einen neueren ersetzt; bitte fragen Sie die Person, die ihn Ihnen geschickt hat.
error-link-revoked = Ihre bisherigen Antworten bleiben gespeichert. Wenn Sie weitermachen möchten, bitten Sie die Personen, die Sie eingeladen haben, um einen neuen Link.
error-joining-closed = Über diese Adresse ist zurzeit keine Teilnahme an einer Studie möglich. Bitte fragen Sie die Personen, von denen Sie die Adresse haben.
error-study-put-away = Zurzeit kann niemand teilnehmen. Ihre bisherigen Antworten sind gespeichert. Bei Fragen wenden Sie sich bitte an die Personen, die Sie eingeladen haben.
error-study-deleted = Diese Studie ist beendet, und alles über die Personen, die teilgenommen haben, wurde gelöscht. Sie können diese Seite schließen.
error-not-yet = Vorher kommt noch etwas anderes. Sie werden dorthin weitergeleitet.
error-query-not-found = Dieses Paar gehört nicht zu Ihren Paaren. Bitte machen Sie mit dem Paar weiter, das Ihnen gezeigt wird.
error-query-not-shown = Dieses Paar wurde Ihnen noch nicht gezeigt. Bitte machen Sie mit dem Paar weiter, das Ihnen gezeigt wird.
error-answer-misdirected = Diese Antwort wurde schon zu einem anderen Paar gegeben. Bitte laden Sie die Seite neu und antworten Sie noch einmal.
error-undo-too-late = Nur Ihre neueste Antwort lässt sich zurücknehmen, und dies ist eine frühere.
error-trial-not-found = Dieser Roboter gehört nicht zu denen, die Sie bewerten sollen. Bitte machen Sie mit dem weiter, der Ihnen gezeigt wird.
error-trial-not-shown = Diesen Roboter haben Sie noch nicht gesehen. Bitte machen Sie mit dem weiter, der Ihnen gezeigt wird.
error-rated-already = Diesen Roboter haben Sie schon bewertet, und diese Bewertung zählt. Ihre letzte Bewertung können Sie noch ändern.
error-correction-too-late = Nur die letzte Bewertung lässt sich ändern, und dies ist eine frühere.
error-rating-misdirected = Diese Bewertung wurde schon zu einem anderen Roboter abgegeben. Bitte laden Sie die Seite neu und bewerten Sie noch einmal.
error-setting-over = Sie sind schon weitergegangen, und es gilt die Einstellung, die Sie dabei hatten.
error-setting-invalid = Ein Regler fehlt oder steht, wo er nicht stehen kann. Bitte laden Sie die Seite neu und stellen Sie den Roboter noch einmal ein.
error-setting-changed-too-often = Die Regler wurden so oft verschoben, dass nichts mehr gespeichert wird. Bitte gehen Sie mit der Einstellung weiter, wie sie ist.
error-foreign-form = Diese Anfrage kam von einer anderen Website und wurde abgelehnt. Bitte benutzen Sie die Seiten dieser Website.
error-page-not-found = Unter dieser Adresse gibt es keine Seite. Wenn ein Link Sie hierher geführt hat, prüfen Sie bitte, ob er vollständig ist.
error-not-understood = In diesem Formular fehlt etwas, oder etwas ist nicht gültig. Bitte gehen Sie zurück und prüfen Sie es.
error-database-busy = Der Server ist beschäftigt oder noch nicht bereit. Es wurde nichts gespeichert; bitte versuchen Sie es gleich noch einmal.
error-storage-unavailable = Gespeicherte Dateien sind im Augenblick nicht erreichbar. Nichts, was Sie geantwortet haben, ist verloren; bitte versuchen Sie es in einer Minute noch einmal.
error-unforeseen = Das ist unser Fehler, und er wurde festgehalten. Bei diesem Schritt wurde nichts gespeichert; bitte versuchen Sie es noch einmal.

## Paare (Vorsilbe pair-)

pair-question = Welchen Roboter hätten Sie lieber?
pair-title = Was ist Ihnen lieber?
pair-left = Links
pair-right = Rechts
pair-top = Oben
pair-bottom = Unten
pair-equal = Gleich gut
pair-skip = Weiß nicht
pair-left-clip = Linkes Video
pair-right-clip = Rechtes Video
pair-enlarge = Dieses Video vergrößern
pair-progress = Ihr Fortschritt
pair-count = { $answered } von { $wanted }
pair-time-left = noch { $time }
pair-time-left-comparing = { $time } zum Vergleichen
pair-time-left-minute = etwa eine Minute
pair-time-left-minutes = etwa { $minutes } min
pair-time-left-hours = etwa { $hours } h
pair-replay = Von vorn
pair-undo = Rückgängig
pair-play = Abspielen
pair-pause = Anhalten
pair-back = Ein Bild zurück
pair-forward = Ein Bild vor
pair-position = Stelle in beiden Videos
pair-position-value = { $seconds } von { $total } Sekunden
pair-speed = Tempo
pair-speed-value = { $rate }-faches Tempo
pair-play-both = Beide abspielen
pair-play-again = Noch einmal
pair-watch-first = Bitte sehen Sie sich zuerst beide einmal an
pair-now-answer = Jetzt können Sie antworten
pair-saving = Wird gespeichert …
pair-saving-earlier = Eine frühere Antwort wird gespeichert …
pair-saved = Gespeichert. { $answered } von { $wanted }.
pair-not-saved = Noch nicht gespeichert. Ein neuer Versuch läuft …
pair-taken-back = Zurückgenommen. Bitte antworten Sie noch einmal.
pair-unplayable = Diese Videos konnten nicht geladen werden.
pair-broken-off = Diese Videos sind stehen geblieben. Sie können sie neu laden oder antworten, wenn Sie genug gesehen haben.
pair-load-again = Neu laden
pair-go-on = Weiter
pair-try-again = Noch einmal versuchen
pair-why = Warum können Sie es nicht sagen?
pair-why-no_difference_seen = Ich sehe keinen Unterschied
pair-why-both_bad = Beide sind schlecht
pair-why-not_comparable = Zu verschieden, um sie zu vergleichen
pair-why-not_seen = Ich konnte es nicht gut sehen
pair-why-other = Ein anderer Grund
pair-why-none = Möchte ich nicht sagen
pair-why-back = Zurück zum Paar
pair-mattered = Was hat den Unterschied gemacht?
pair-mattered-none = Nichts Bestimmtes
mattered-speed = Wie schnell er sich bewegt hat
mattered-speed_near = Wie schnell er nahe bei mir war
mattered-force = Wie fest er berührt oder gedrückt hat
mattered-spilling = Wie viel er verschüttet hat
mattered-path = Welchen Weg er genommen hat
mattered-smoothness = Wie ruhig er sich bewegt hat
mattered-outcome = Wie gut er seine Aufgabe erfüllt hat
hints-title = Soll der Roboter etwas anders machen?
hints-lead = Wenn Ihnen etwas einfällt, kreuzen Sie es an: höchstens { $most } Hinweise. Wenn Ihnen nichts besonders wichtig ist, gehen Sie einfach weiter.
hints-question = Mir wäre lieber
hints-note = Am meisten zählen weiterhin Ihre Antworten zu den Paaren. Solange Sie vergleichen, können Sie Ihre Hinweise ändern oder zurücknehmen.
hints-go-on = Weiter
hints-too-many = Das sind mehr als { $most } Hinweise. Bitte lassen Sie nur die stehen, die Ihnen am wichtigsten sind.
hints-contradicting = Zwei davon widersprechen sich. Bitte lassen Sie nur einen von beiden stehen.
hints-change = Einen Hinweis geben oder ändern
hints-link = Hinweise
hints-less = weniger: { $what }
hints-more = mehr: { $what }
waiting-heading = Ihr nächstes Paar wird vorbereitet
waiting-text = Gerade werden neue Videos des Roboters aufgenommen. Danach geht es hier automatisch weiter; Sie brauchen nichts zu tun.
waiting-answered = Sie haben bisher { $answered } von { $wanted } Antworten gegeben; alles ist sicher gespeichert.

## Übung (Vorsilbe practice-)

practice-title = Übung
practice-count = Übung { $answered } von { $wanted }
practice-lead = Dies ist eine Übung und zählt nicht. Probieren Sie die Tasten aus:
practice-lead-touch = Dies ist eine Übung und zählt nicht. Spielen Sie ab, halten Sie an, verschieben Sie den Regler; tippen Sie dann auf eine Antwort.
practice-key-pause = anhalten
practice-key-speed = Tempo
practice-key-replay = von vorn
practice-key-answer = antworten
practice-key-step = ein Bild
practice-key-used = { $key }: ausprobiert
practice-all-used = Sie haben alle Tasten ausprobiert. Antworten Sie, wann Sie möchten.

## Pausen (Vorsilbe break-)

break-heading =
    { $answered ->
        [one] Eine Antwort ist geschafft
       *[other] { $answered } Antworten sind geschafft
    }
break-lead = Alles ist sicher gespeichert. Schauen Sie aus dem Fenster, strecken Sie sich, trinken Sie ein Glas Wasser. Kommen Sie wieder, wann Sie möchten, auch an einem anderen Tag: Ihr Link führt hierher zurück.
break-left = Noch { $count }, { $time }.
break-left-unknown = Noch { $count }.
break-go-on = Weiter
break-key = oder Eingabetaste drücken

## Warten (prefix wait-)

evaluation-minutes-left =
    { $minutes ->
        [one] Noch etwa eine Minute.
       *[other] Noch etwa { $minutes } Minuten.
    }
wait-hours = Noch etwa { $hours } Stunden.
wait-unknown = Wie lange das dauert, lässt sich noch nicht sagen, denn es geschieht hier zum ersten Mal.
wait-others-first = Es kann länger dauern, weil andere schon vor Ihnen warten.

## Bewertung (Vorsilbe evaluation-)

evaluation-progress = Bewertete Roboter
evaluation-count = { $rated } von { $wanted } bewertet
evaluation-robot = Roboter { $letter }
evaluation-film = Roboter { $letter } bei der Arbeit
evaluation-repetition =
    { $count ->
        [one] Diesen Roboter sehen Sie einmal.
       *[other] Durchgang { $number } von { $count } mit diesem Roboter
    }
evaluation-satisfaction = Wie zufrieden sind Sie insgesamt mit diesem Roboter?
evaluation-satisfaction-low = überhaupt nicht zufrieden
evaluation-satisfaction-high = völlig zufrieden
evaluation-personalisation = Wie stark ist sein Verhalten Ihrem Eindruck nach auf Sie zugeschnitten?
evaluation-personalisation-low = überhaupt nicht auf mich zugeschnitten
evaluation-personalisation-high = völlig auf mich zugeschnitten
evaluation-reason = Warum? Gern in Ihren eigenen Worten
evaluation-save = Speichern und weiter
evaluation-save-change = Änderung speichern
evaluation-changing = Sie ändern Ihre letzte Bewertung.
evaluation-keep = So lassen, wie es ist
evaluation-change-last = Meine letzte Bewertung ändern (Roboter { $letter })
evaluation-rate-now = Bitte bewerten Sie, was der Roboter eben getan hat.
evaluation-watch-first = Bitte sehen Sie ihn sich zuerst einmal bis zum Ende an
evaluation-now-rate = Jetzt können Sie bewerten
evaluation-keys = Tasten: zweimal 1 bis 5, dann die Eingabetaste. Die Rücktaste nimmt die letzte Eingabe zurück.
evaluation-saving = Wird gespeichert …
evaluation-not-saved = Noch nicht gespeichert. Ein neuer Versuch läuft …
evaluation-refused = Das wurde nicht gespeichert, weil dieser Roboter nicht mehr an der Reihe ist. Die Seite wird neu geladen …
evaluation-unplayable = Dieses Video konnte nicht geladen werden.
evaluation-load-again = Neu laden
evaluation-play = Abspielen
evaluation-pause = Anhalten
evaluation-position = Stelle im Video
evaluation-position-value = { $seconds } von { $total } Sekunden
evaluation-speed = Tempo
evaluation-speed-value = { $rate }-faches Tempo
evaluation-coming = Als Nächstes kommt Roboter { $letter }
evaluation-coming-text = Er wird gleich gestartet. Dann geht es hier automatisch weiter.
evaluation-moving = Roboter { $letter } bewegt sich. Bitte schauen Sie zu.
evaluation-moving-text = Sobald er fertig ist, werden Sie nach Ihrer Meinung gefragt.
evaluation-waiting-title = Ihre Roboter werden vorbereitet
evaluation-waiting-text = Aus Ihren Antworten lernen gerade Roboter. Sobald sie bereit sind, sehen Sie mehrere Roboter bei der Arbeit und bewerten jeden davon. Bezeichnet sind sie nur mit Buchstaben: Roboter A, Roboter B und so weiter.
evaluation-next-title = Der nächste Roboter wird vorbereitet
evaluation-next-text = Sie haben bisher { $rated } von { $wanted } Bewertungen abgegeben; alles ist sicher gespeichert. Das nächste Video entsteht gerade. Danach geht es hier automatisch weiter.
evaluation-waiting-progress = Wie weit Ihre Roboter sind
evaluation-step-learning = Aus Ihren Antworten wird gelernt
evaluation-step-training = Die Roboter werden trainiert
evaluation-step-filming = Die Roboter werden gefilmt
evaluation-step-packing = Die Roboter werden bereitgestellt
evaluation-robots-ready = Fertig trainierte Roboter: { $ready } von { $count }. Gesamtfortschritt: { $percent } %.
evaluation-may-close = Sie können diese Seite schließen: Ihre Antworten sind sicher gespeichert, und die Arbeit geht ohne Sie weiter. Ihr Link bringt Sie hierher zurück. Wenn Sie die Seite geöffnet lassen, geht es hier automatisch weiter.
evaluation-trouble = Etwas ist schiefgegangen. Es wird noch einmal versucht, und die Person, von der Sie den Link haben, kann es sehen. Von Ihren Angaben ist nichts verloren gegangen.
evaluation-done-title = Alle Roboter sind bewertet
evaluation-done-text =
    { $count ->
        [one] Ihre Bewertung ist sicher gespeichert. Vielen Dank.
       *[other] Ihre { $count } Bewertungen sind sicher gespeichert. Vielen Dank.
    }

## Direkter Vergleich (Vorsilbe head-to-head-)

head-to-head-explanation = Zwei der Roboter, die Sie bewertet haben, nebeneinander und ohne ihre Buchstaben. Die Seiten wechseln von Paar zu Paar.
head-to-head-change-last = Letzte Antwort ändern
head-to-head-changing = Sie ändern Ihre letzte Antwort; sie war: { $said }.
head-to-head-done =
    { $count ->
        [one] Auch Ihr direkter Vergleich ist sicher gespeichert.
       *[other] Auch Ihre { $count } direkten Vergleiche sind sicher gespeichert.
    }

## Einen Roboter mit Reglern einstellen (Vorsilbe setting-)

setting-title = Stellen Sie selbst einen Roboter ein
setting-lead = Verschieben Sie die Regler, bis der Roboter die Aufgabe so ausführt, wie es Ihnen am besten gefällt. Sobald Sie einen Regler loslassen, folgt der Film.
setting-film = Der Roboter mit dieser Einstellung
setting-exact = Der Film zeigt genau Ihre Einstellung.
setting-near = Der Film zeigt von den gefilmten Einstellungen die, die Ihrer am nächsten kommt. Ihre wird gerade gefilmt und erscheint von selbst.
setting-filmed = Im Film: { $place }
setting-sliders = Regler
setting-middle = in der Mitte, unverändert
setting-unchanged = unverändert
setting-place = { $end }, { $degree }
setting-degree-1 = ein wenig
setting-degree-2 = merklich
setting-degree-3 = deutlich
setting-degree-4 = so weit es geht
setting-less = weniger
setting-more = mehr
setting-reset = Alle unverändert
setting-show = Film zeigen
setting-go-on = Diese Einstellung behalten und weiter
setting-final = Ihre Einstellung wird gespeichert, während Sie die Regler verschieben. Sobald Sie weitergehen, lässt sie sich nicht mehr ändern.
setting-saved = Gespeichert.
setting-refused = Das wurde nicht gespeichert, weil Sie schon weitergegangen sind. Die Seite wird neu geladen …
setting-waiting-title = Die Regler werden vorbereitet
setting-waiting-text = Als Nächstes stellen Sie selbst einen Roboter ein, und ein Film zeigt, was jeder Regler bewirkt. Die Filme entstehen noch.
setting-waiting-close = Sie können diese Seite schließen: Ihre Antworten sind sicher gespeichert, und Ihr Link führt Sie hierher zurück. Wenn Sie die Seite geöffnet lassen, geht es hier automatisch weiter.
setting-speed_far = Tempo unterwegs
setting-speed_far-low = langsamer
setting-speed_far-high = schneller
setting-speed_near = Tempo nahe am Ziel
setting-speed_near-low = langsamer
setting-speed_near-high = schneller
setting-speed_early = Tempo am Anfang
setting-speed_early-low = langsamer
setting-speed_early-high = schneller
setting-speed_late = Tempo gegen Ende
setting-speed_late-low = langsamer
setting-speed_late-high = schneller
setting-smooth = Gleichmäßigkeit der Bewegung
setting-smooth-low = weniger gleichmäßig
setting-smooth-high = gleichmäßiger
setting-hesitate = Verweilen kurz vor dem Ziel
setting-hesitate-low = kürzer
setting-hesitate-high = länger
setting-from_below = Höhe, aus der er kommt
setting-from_below-low = mehr von oben
setting-from_below-high = mehr von unten
setting-to_side = Seite, von der er kommt
setting-to_side-low = mehr von rechts
setting-to_side-high = mehr von links
setting-press = Druck
setting-press-low = sanfter
setting-press-high = fester
setting-push = Unterwegs in Richtung { $name } gedrückt
setting-gain = Tempo von { $name } allein
setting-shift = Am Ziel in Richtung { $name } daneben

## Vorschau

preview-mark = Vorschau: Nichts hiervon zählt
